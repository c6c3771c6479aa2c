"""Shims of CUDA modules: one file per upstream module, named as it is imported; see finder.py."""
