"""How fast a model samples on this machine, beside the arithmetic that it cannot do without."""
