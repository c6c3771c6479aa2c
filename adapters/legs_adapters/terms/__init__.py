"""The forms of a photometric L1 term: how each is found, and what is advised where it cannot be edited."""
