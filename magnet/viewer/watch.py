"""`magnet view FILE...`: takes side by side, with the truth as ghosts and the steps of their denoising."""

from __future__ import annotations

from typing import Any

from magnet.body.base import Body
from magnet.export.page.rig import CROWD, Style, first_style
from magnet.export.page.takes import Take, in_a_row, numbered, same_length
from magnet.viewer.clock import Clock
from magnet.viewer.levels import level_image
from magnet.viewer.stage import Stage
from magnet.viewer.troupe import Look, Troupe


class Viewer(Stage):
    """Watch takes side by side.

    Args:
        takes: of one frame rate.
        truth: shown as ghosts in every take.
    """

    def __init__(
        self,
        takes: list[Take],
        body: Body,
        truth: Take | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        look: Look | None = None,
    ) -> None:
        takes = numbered(takes)
        look = look or first_look(takes)
        super().__init__(body, look, host, port, takes[0].label if len(takes) == 1 else "magnet")
        self.clock = Clock(max(each.frames for each in takes), takes[0].scene.fps)
        with self.server.atomic():
            for each, offset in zip(takes, in_a_row(takes), strict=True):
                ghost = None if truth is None else same_length(truth, each)
                self.troupes.append(Troupe(self.server, "/stage", body, each, offset, self.look, ghost))
            self.frame_all()
            self.add_timeline()
            if any(each.recording is not None for each in takes):
                self._add_denoising(next(i for i, each in enumerate(takes) if each.recording is not None))
            self.add_looks(truth is not None)
            self.add_saving()
        self.draw()

    # -- denoising steps -----------------------------------------------------------------------

    def _add_denoising(self, index: int) -> None:
        troupe, recording = self.troupes[index], self.troupes[index].take.recording
        assert recording is not None
        gui = self.server.gui
        with gui.add_folder("Denoising"):
            step = gui.add_slider("denoising step", 0, recording.steps, 1, recording.steps)
            picture = gui.add_image(level_image(recording, recording.steps - 1), label="levels: time, people")
            text = gui.add_markdown("")

        def show(_: Any) -> None:
            at = int(step.value)
            with self.lock:
                done = at >= recording.steps
                troupe.estimate = None if done else recording.at(at)
                self.shown = -1
            picture.image = level_image(recording, min(at, recording.steps - 1))
            text.content = "finished" if done else f"expected after step {at + 1} of {recording.steps}"
            self.draw()

        step.on_update(show)


def first_look(takes: list[Take], style: Style | None = None, shadows: bool = True) -> Look:
    """What is shown at first: of a crowd what is light, unless a style is asked for."""
    crowd = sum(len(each.slots) for each in takes) > CROWD
    style = style or first_style(sum(len(each.slots) for each in takes))
    rich = not crowd
    return Look(style=style, trails=rich, contacts=rich, collisions=rich, shadows=shadows and rich)
