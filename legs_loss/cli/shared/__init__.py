"""Shared by the commands: the parser, checks of arguments, and the settings that are affordable on a CPU."""
