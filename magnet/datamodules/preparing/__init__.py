"""Recordings to clips, and a whole download to a store.

Any check here raises DataError of a recording whose numbers cannot be right.
"""
