"""Python as data: files, syntax trees, reaching definitions, name resolution, calls. Knows neither torch nor splats."""
