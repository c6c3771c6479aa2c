"""The loss on a CUDA GPU: legs.cu, compiled at run time by the NVRTC that torch's CUDA wheels bring along.

    nvrtc.py    finds and calls the compiler         cache.py    keeps what it compiled on disk
    driver.py   loads and launches (libcuda)         modules.py  a kernel by name: cached, compiled, loaded once
    launch.py   what a kernel is given, and its grid operations.py  the operations, differentiable
    backend.py  the backend for backends.py

No package of CUDA bindings serves torch 1.12.1 + cu113 on Python 3.7 as well as today's torch, so the dozen functions
of the two libraries that are needed are called through ctypes.
"""
