"""`magnet view FILE...`: takes side by side, with the truth as ghosts and the steps of their denoising."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnet.body.base import Body
from magnet.export.drawing import Style
from magnet.export.page.palette import agent_colours
from magnet.export.page.rig import CROWD, first_style
from magnet.export.page.takes import ShownTake, in_a_row, numbered, same_length, titled
from magnet.export.trace import DenoisingTrace
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.noise import LEVELS
from magnet.viewer.base import ViewerBase
from magnet.viewer.clock import Clock
from magnet.viewer.scene_view import RenderOptions, SceneView

CELL = 14


def level_image(recording: DenoisingTrace, step: int, slots: tuple[int, ...]) -> NDArray[np.uint8]:
    """Noise levels after a step: full colour is clean, white is pure noise; the window is framed. -> (H, W, 3)

    slots: of the recording's P people, which say their colours.
    """
    levels = recording.levels[step].numpy().astype(float) / LEVELS  # (N, P)
    N = len(levels)
    noise = levels.T[..., None]  # (P, N, 1)
    cells = (1 - noise) * agent_colours(slots)[:, None] + noise * 255.0
    image = np.kron(cells, np.ones((CELL, CELL, 1)))
    image[::CELL], image[:, ::CELL] = 214, 214
    first = int(recording.start[step]) // TOKEN_FRAMES
    last = min(first + recording.estimates.frames // TOKEN_FRAMES, N)
    image[:2, first * CELL : last * CELL] = image[-2:, first * CELL : last * CELL] = 60
    image[:, first * CELL : first * CELL + 2] = image[:, last * CELL - 2 : last * CELL] = 60
    return image.round().astype(np.uint8)


class Viewer(ViewerBase):
    """Watch takes side by side.

    Args:
        takes: all of one frame rate.
        truth: ground truth, shown as ghosts in every take.
    """

    def __init__(
        self,
        takes: list[ShownTake],
        body: Body,
        truth: ShownTake | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        render: RenderOptions | None = None,
    ) -> None:
        title, takes = titled(takes), numbered(takes)
        render = render or default_render_options(takes)
        super().__init__(body, render, host, port, title)
        self.clock = Clock(max(each.frames for each in takes), takes[0].scene.fps)
        with self.server.atomic():
            for number, (each, offset) in enumerate(zip(takes, in_a_row(takes), strict=True)):
                ghost = None if truth is None else same_length(truth, each)
                name = f"/stage/take_{number}"
                self.views.append(SceneView(self.server, name, body, each, offset, self.render, ghost))
            self.frame_all()
            self.add_timeline()
            if any(each.recording is not None for each in takes):
                self._add_denoising(next(i for i, each in enumerate(takes) if each.recording is not None))
            self.add_render_controls(truth is not None)
            self.add_saving()
        self.draw()

    # -- denoising steps -----------------------------------------------------------------------

    def _add_denoising(self, index: int) -> None:
        view, recording = self.views[index], self.views[index].take.recording
        slots = view.take.slots
        assert recording is not None
        gui = self.server.gui
        with gui.add_folder("Denoising"):
            step = gui.add_slider("denoising step", 0, recording.steps, 1, recording.steps)
            picture = gui.add_image(level_image(recording, recording.steps - 1, slots), label="levels: time, people")
            text = gui.add_markdown("")

        def show(_: Any) -> None:
            at = int(step.value)
            with self.lock:
                done = at >= recording.steps
                view.estimate = None if done else recording.at(at)
                self.shown = -1
            picture.image = level_image(recording, min(at, recording.steps - 1), slots)
            text.content = "finished" if done else f"expected after step {at + 1} of {recording.steps}"
            self.draw()

        step.on_update(show)


def default_render_options(takes: list[ShownTake], style: Style | None = None, shadows: bool = True) -> RenderOptions:
    """Default options: a crowd has few triangles and no extras, unless a style is given."""
    crowd = sum(len(each.slots) for each in takes) > CROWD
    style = style or first_style(sum(len(each.slots) for each in takes))
    rich = not crowd
    return RenderOptions(style=style, trails=rich, contacts=rich, collisions=rich, shadows=shadows and rich)
