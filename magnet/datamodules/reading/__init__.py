"""Files of a data set to recordings: what its reader needs to know of its formats."""
