"""The rules that skip terms, one file for each cause."""
