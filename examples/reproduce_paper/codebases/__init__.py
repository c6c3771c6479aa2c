"""Arms trained by another codebase, by its own script with its own density control.

profile.py reads how a codebase is trained, rendered and told to densify (profiles/*.toml); launch.py runs one of its
scripts with another seed and counts what was weighted; training.py trains, renders and scores one row; comparison.py
keeps the rows of all arms and finds the thresholds of the count control.
"""
