"""What knows other people's code: finding and rewriting the loss of a 3DGS codebase. Uses legs_loss's public face."""
