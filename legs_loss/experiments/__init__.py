"""Experiments: arms that differ in one thing, trained side by side over several seeds, and what their differences say.

arms.py names an arm; weighting.py holds the weights that no stored map can give; running.py trains and keeps one row an
arm and seed; baseline.py proves that the baseline is unweighted; statistics.py and studies.py make the tables.
"""
