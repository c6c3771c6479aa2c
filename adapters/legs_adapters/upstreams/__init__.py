"""Weight losses that are not in a script: one module for each codebase that needs more than the general rules."""
