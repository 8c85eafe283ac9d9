"""Scenes in the browser: watched, played live, or kept as one self-contained page."""

from magnet.export.page.html import save_html
from magnet.export.page.takes import ShownTake, take, takes
from magnet.viewer.reading import read_takes

__all__ = ["ShownTake", "read_takes", "save_html", "take", "takes"]
