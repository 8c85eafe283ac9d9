"""Scenes in the browser: watched, played live, or kept as one self-contained page."""

from magnet.viewer.html import save_html
from magnet.viewer.takes import Take, read_takes, take, takes

__all__ = ["Take", "read_takes", "save_html", "take", "takes"]
