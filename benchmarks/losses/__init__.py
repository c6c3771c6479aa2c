"""The parts of loss.py: contenders, images, timing, tables and the machine; other benchmarks use them too."""
