"""Find and rewrite the loss of a 3DGS codebase. Uses legs_loss's public face."""
