"""The forms of a photometric L1 term: how each is found, and the advice where it cannot be edited."""
