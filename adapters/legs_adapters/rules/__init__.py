"""Decide on each L1 term: weighted, skipped by a rule, or in need of a manual edit."""
