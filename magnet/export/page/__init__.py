"""Scenes as one web page that plays by itself."""
