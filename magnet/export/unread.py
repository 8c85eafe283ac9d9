"""Files of motion that are not read, and how each becomes one that is."""

from __future__ import annotations

from collections.abc import Iterable

MARKERS = (
    "it holds markers, not joints: let the program that took them solve skeletons, and export BVH or FBX, or write "
    "joint centres as a table, .csv"
)
TENSORS = "load it with torch.load, and save its tensors as NumPy arrays in an .npz: poses, trans, betas, fps"
ADVICE = {
    ".c3d": MARKERS,
    ".trc": MARKERS,
    ".pth": TENSORS,
    ".npy": "an array alone does not tell what it is: save rotations as poses, trans and mocap_frame_rate in an .npz, "
    "positions of joints as a table, .csv",
    ".tsv": "rename it to .csv: tabs between columns are understood",
    ".txt": "rename a table of joint positions to .csv",
    ".parquet": "write it as CSV, such as by pandas: read_parquet(FILE).to_csv(FILE.csv, index=False)",
    ".json": "write positions of joints as a table, .csv, rotations as an .npz",
    ".amc": "magnet data prepare cmu reads CMU's; convert others to BVH",
    ".asf": "magnet data prepare cmu reads CMU's; convert others to BVH",
    ".blend": "export glTF, FBX or BVH from Blender",
    ".xlsx": "save it as CSV UTF-8",
}
"""What to do with a file, by its suffix."""


def advice_for(suffixes: Iterable[str]) -> str:
    """What to do with files of these suffixes, to end an error with; "" where nothing is known.

    >>> advice_for([".blend", ".bvh"])
    '; .blend: export glTF, FBX or BVH from Blender'
    """
    return "".join(f"; {suffix}: {ADVICE[suffix]}" for suffix in sorted(set(suffixes)) if suffix in ADVICE)
