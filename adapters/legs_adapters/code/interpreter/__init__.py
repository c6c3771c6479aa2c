"""Interpret functions of a checkout on given values: a small subset of Python, with bounded steps.

No code of the checkout is executed. What the interpreter, or the library that replaces the checkout's imports, does not
support ends the evaluation with `Unknown`, which names the place.
"""
