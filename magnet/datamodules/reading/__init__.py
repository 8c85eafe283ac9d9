"""Files of a data set to recordings: what its reader needs to know of its formats.

Any function here may raise DataError, of a file that is missing or damaged or cannot be what it is read as.
"""
