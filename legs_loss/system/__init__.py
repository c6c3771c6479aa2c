"""Files, locks, signals, the terminal, installed packages: the interface to the machine.

The modules are independent of images and losses, and do not import torch.
"""
