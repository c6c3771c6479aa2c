"""The parts that the shims of Inria's family of rasterizers share."""
