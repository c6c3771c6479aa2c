"""Python as data: files, syntax trees, reaching definitions, name resolution, calls. No torch, no splats."""
