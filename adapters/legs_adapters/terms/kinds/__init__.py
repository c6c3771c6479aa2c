"""The kinds of photometric term, one file each: how it is found, edited and advised on. A new file is a new kind."""
