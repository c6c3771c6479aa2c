"""Changing a checkout safely: one command at a time, all files or none, and nothing that a stranger's file asks for."""
