"""Decide what becomes of each L1 term: weighted, skipped by a rule, or left to a person."""
