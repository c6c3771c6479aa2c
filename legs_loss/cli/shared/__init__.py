"""Shared by the commands: the parser, checks of arguments, a scene and its photographs, pictures."""
