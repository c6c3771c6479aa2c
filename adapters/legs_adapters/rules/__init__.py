"""The reasons why an L1 term is left unweighted."""
