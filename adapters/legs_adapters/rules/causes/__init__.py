"""One file for each cause for which a term is left."""
