"""Export and import: pictures, films, and files that other tools read and write."""

from magnet.export.bvh import save_bvh
from magnet.export.drawing import Camera
from magnet.export.glb import save_glb
from magnet.export.joints_csv import save_csv
from magnet.export.npz import load_smplx, save_smplx
from magnet.export.picture import contact_sheet
from magnet.export.retarget import load_rigs
from magnet.export.video import render_video
from magnet.motion.resample import resampled
from magnet.motion.tracked import LiveFrames, bridged

__all__ = [
    "Camera",
    "LiveFrames",
    "bridged",
    "contact_sheet",
    "load_rigs",
    "load_smplx",
    "render_video",
    "resampled",
    "save_bvh",
    "save_csv",
    "save_glb",
    "save_smplx",
]
