"""Clips in memory or on disk, and batches of windows of them."""
