"""Experiments: arms that differ in one setting, trained side by side with several seeds, and their differences.

arms.py names an arm; baseline.py proves that the baseline is unweighted; running.py trains and keeps one row an arm
and seed; statistics.py compares rows; tables.py prints them.
"""
