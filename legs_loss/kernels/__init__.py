"""The two sums of the loss (weighted L1, SSIM) made fast. contract.py defines a backend, available.py chooses one.

The torch code in loss.py, similarity.py and weights.py is the reference, which each backend equals up to rounding.
"""
