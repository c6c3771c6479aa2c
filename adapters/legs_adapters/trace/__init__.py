"""Run a training script for a few steps, and see which difference is the photometric one."""
