"""Find the functions of a checkout that are 3DGS's SSIM, by the forms that its code is met in."""
