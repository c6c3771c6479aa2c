"""Evaluate functions of a checkout on given values, without running them: a small part of Python, every step bounded.

No code of the checkout is executed. What is not known to the interpreter, or to the library that stands for what the
checkout imports, ends the evaluation with `Unknown`, which names the place.
"""
