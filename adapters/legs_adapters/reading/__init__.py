"""Reading somebody's code as a tree: its files and modules, how values flow, what is trained, what an L1 compares."""
