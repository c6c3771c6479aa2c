"""Shims of CUDA modules: one file an upstream module, named as it is imported; see finder.py."""
