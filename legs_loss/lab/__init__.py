"""The laboratory beside the core, which nothing of it needs: Gaussians drawn and trained on the CPU, and compared.

simd/, rasterizer/, surfels/ and embedded/ draw; training/ is a complete small 3D Gaussian Splatting; experiments/
trains arms with several seeds; report/ and viewer/ show them; commands/ are its sub-commands of ``legs``.
"""
