"""The loss on a CUDA GPU: legs.cu, compiled at run time by the NVRTC that torch's CUDA wheels bring along.

    nvrtc.py    finds and calls the compiler      modules.py  a variant's kernels: cached, compiled, loaded once
    driver.py   loads and launches (libcuda)      backend.py  what a kernel is given, and the operations for backends.py

No package of CUDA bindings serves torch 1.12.1 + cu113 on Python 3.7 as well as today's torch, so the dozen functions
of the two libraries that are needed are called through ctypes.
"""
