"""Recordings to clips, and a whole download to a store."""
