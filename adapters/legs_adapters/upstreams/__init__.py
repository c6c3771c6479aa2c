"""Weight what is not a line in a script: one module for each codebase that needs more than the generic rule."""
