"""A page of instructions in the live app."""

from __future__ import annotations

from typing import Any

GUIDE = """\
**Watch.** The model makes motion about a second ahead of what you see, for as long as somebody looks. Drag the mouse
to turn the camera, with the right button to shift it, the wheel to come nearer; it moves back by itself where somebody
would leave the picture.

**The timeline** along the bottom has a track for each person: full colour is generated, pale was given, diamonds are
keyframes. Drag its slider to go back and forth; *Restart from this frame* forgets what comes after.

**Begin.** *example* opens scenes that come with the model, or nothing at all; *Start anew* begins again with *how many
people*.

**Steer.** Choose *whom*, then drag the arrows on the floor, or the ring to turn. With `motion_control` that person
goes there and the others answer; with `inbetweening` the arrows are that person's next keyframe, a second ahead.

**Keyframes.** Go to a moment, choose a person, *Add keyframe here*. Drag its arrows and ring; take the *pose of*
another frame; *drag its* hand or foot by arrows of their own; give it a time, also later than all there is. *Generate
between* makes everything anew from a second before the first keyframe to the last.

**Keep.** *Save* downloads the scene: npz, glb for Blender, bvh, a page that plays by itself.
"""


def add_guide(server: Any) -> None:
    """A button that opens the page."""
    button = server.gui.add_button("How to", icon="help")

    def show(event: Any) -> None:
        with event.client.gui.add_modal("How to play with it") as page:
            event.client.gui.add_markdown(GUIDE)
            close = event.client.gui.add_button("Close")
        close.on_click(lambda _: page.close())

    button.on_click(show)
