"""What the shims of Inria's family of rasterizers share."""
