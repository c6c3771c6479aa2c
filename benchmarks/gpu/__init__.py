"""Every check and measurement that needs a GPU, in one command: `python -m benchmarks.gpu --help`.

stages.py lists the stages in their order; running.py runs each in a process of its own, with a time limit, and keeps
what it has found. machine.py, tests.py, times.py, behaviour.py, building.py and training.py are the stages; imports.py
says what a codebase's scripts lack before its modules are built; measured.py runs inside a training and times its
steps; aims.py compares the results with the aims.
"""
