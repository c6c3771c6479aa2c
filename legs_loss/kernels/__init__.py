"""The LEGS loss made fast: one file a backend. The torch code in ssim.py and loss.py is what each must equal."""
