"""Which functions of a checkout are 3DGS's SSIM: their value, worked out on small images, says so."""
