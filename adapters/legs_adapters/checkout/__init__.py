"""Change a checkout safely: one command at a time, all files or none; its files are not trusted."""
