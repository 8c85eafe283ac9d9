"""What leaves the project: moving and still pictures, and files other tools read."""

from magnet.export.npz import load_smplx, save_smplx
from magnet.export.picture import contact_sheet, topview
from magnet.export.stage import Camera
from magnet.export.video import render_video

__all__ = ["Camera", "contact_sheet", "load_smplx", "render_video", "save_smplx", "topview"]
