"""`Motion`: a scene with its body, which shows and saves itself; what `magnet.api` gives."""

from __future__ import annotations

import base64
import html
import inspect
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from torch import Tensor

from magnet.body import Body, load_body, on_floor
from magnet.checks import require_whole
from magnet.errors import warn_user
from magnet.export import formats
from magnet.files import suffixed, whole
from magnet.motion.scene import Scene
from magnet.precision import cpu_by_default

Player = Literal["page", "film"]
OPTIONS = tuple(
    name for name, one in inspect.signature(formats.write).parameters.items() if one.kind is one.KEYWORD_ONLY
)
"""Options of `Motion.save`."""


@dataclass(frozen=True, repr=False)
class Motion(Scene):
    """A scene with its body, which can show and save itself; usable wherever a `Scene` is."""

    model: Body | None = None  # the body model `betas` belong to; None: the open one
    notes: tuple[str, ...] = ()  # notes on how it was read

    @classmethod
    def of(cls, scene: Scene, model: Body | None = None, notes: Sequence[str] = ()) -> Motion:
        """A `Motion` of a scene."""
        fields = {**scene.tensors(), "fps": scene.fps, "body": scene.body, "names": scene.names}
        return cls(**fields, model=model, notes=tuple(notes))  # type: ignore[arg-type]

    def plain(self) -> Scene:
        """The plain `Scene`."""
        tensors = self.tensors()
        return Scene(**tensors, fps=self.fps, body=self.body, names=self.names)

    @cpu_by_default
    def joints(self) -> Tensor:
        """World joints of everybody. -> (B, T, P, 22, 3) metres"""
        return self._body().joints(self)

    @cpu_by_default
    def vertices(self) -> Tensor:
        """World vertices of everybody. -> (B, T, P, V, 3) metres"""
        return self._body().vertices(self)

    @cpu_by_default
    def on_floor(self) -> Motion:
        """The same motion with the lowest standing person on y = 0, the models' floor; for each scene separately."""
        return Motion.of(on_floor(self.plain(), self._body()), self.model, self.notes)

    @cpu_by_default
    def save(self, path: str | Path, **options: Any) -> Path:
        """Write the format of the path's suffix: .npz .bvh .glb .vrma .csv .html .mp4 .gif .webp .png.

        Options are those of `magnet.export.formats.write`: fps, unit, smplx, style, title.

        Returns:
            The path written; the first one if a format needs several files (one BVH or VRM animation per person).

        Raises:
            ValueError: a suffix that nothing writes, no such option, or a scene that the format cannot hold.
        """
        path = Path(path)
        if strange := [name for name in options if name not in OPTIONS]:
            raise ValueError(f"save: got option {strange[0]}, expected {', '.join(OPTIONS)}")
        formats.require_frames(self)
        if path.suffix == ".npz" and not options:
            return super().save(path)
        written = formats.write(self.plain(), path, self._body(), **{"context_frames": self.context, **options})
        if others := formats.left_over_said(written):
            warn_user(others)
        return written[0]

    @property
    def context(self) -> int:
        """Number of first frames that were given of everybody."""
        if self.given is None:
            return 0
        whole = (self.given | ~self.present[:, None]).all(dim=0).all(dim=1)
        return int(whole.long().cumprod(dim=0).sum())

    def show(self, scene: int | None = None, player: Player = "page", **options: Any) -> NotebookView:
        """A view that a notebook plays inline.

        Args:
            scene: number of the scene to show; None: all B scenes, side by side.
            player: `page`, an interactive player that needs no server, or `film`, an animated picture.
            options: options of `save` for that kind: style, title, fps.
        """
        if player not in get_args(Player):
            raise ValueError(f"player: got {player!r}, expected {' or '.join(get_args(Player))}")
        if scene is not None:
            require_whole("scene", scene, 0, self.scenes - 1)
        shown = self if scene is None else Motion.of(self.select([scene]), self.model)
        with tempfile.TemporaryDirectory() as folder:
            kind = {"page": ".html", "film": ".webp"}[player]
            if player == "film":
                options = {"style": "skeleton", "fps": 15.0, **options}
            path = shown.save(Path(folder) / f"scene{kind}", **options)
            return NotebookView(path.read_bytes(), kind)

    def _body(self) -> Body:
        return self.model or load_body("open")


@dataclass(frozen=True, repr=False)
class NotebookView:
    """A page or a film: notebooks play it inline; elsewhere `save` it."""

    data: bytes
    kind: str  # .html or .webp

    def _repr_html_(self) -> str:
        if self.kind == ".html":
            page = html.escape(self.data.decode(), quote=True)
            return f'<iframe srcdoc="{page}" style="width:100%;height:520px;border:0" allowfullscreen></iframe>'
        return f'<img alt="scene" src="data:image/webp;base64,{base64.b64encode(self.data).decode()}">'

    def save(self, path: str | Path) -> Path:
        """Write it to a file, for a browser. Returns the path written."""
        path = suffixed(path, self.kind)
        with whole(path) as part:
            part.write_bytes(self.data)
        return path

    def __repr__(self) -> str:
        return f"a {len(self.data) / 1e6:.1f} MB {self.kind}, played in notebooks; elsewhere .save('scene{self.kind}')"
