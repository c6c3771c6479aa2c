"""Find the functions of a checkout that are 3DGS's SSIM, by their values on small images."""
