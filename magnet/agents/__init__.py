"""Agents in processes of their own: each generates itself, hears the others' frames and sends its own."""
