"""Writers of tiny data sets in the on-disk layouts of real ones: made-up motion, true file formats."""
