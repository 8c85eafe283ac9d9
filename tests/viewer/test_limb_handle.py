"""Hands and feet of keyframes, dragged in the live app and gone through by what is generated."""

from __future__ import annotations

from types import SimpleNamespace

import torch

from magnet.body import Body
from magnet.body.reach import LIMBS
from magnet.generation.keyframes import keyframe, limb_places


def test_a_limb_of_a_keyframe_isdragged_by_its_arrows_and_what_is_generated_has_it_there(app, body: Body) -> None:
    live, limb = app.live, app.keys.limb
    app.keys.add(keyframe(live.scene, 0, 48, held=True))
    app.draw()
    assert app.timeline.picture.content.count("<path") == 1  # its diamond, at once
    betas = live.scene.betas[0, 0]
    assert limb.handle is None
    limb.limb.value = "left hand"
    before = limb_places(live.keys[0], "left hand", body, betas)[0]
    torch.testing.assert_close(torch.tensor(limb.handle.position).float(), before, atol=1e-5, rtol=0)
    place = before + torch.tensor([0.0, 0.05, 0.03])
    limb.handle.position = tuple(place.tolist())
    limb.dragged(SimpleNamespace(phase="end"))
    limb.limb.value = "right foot"
    moved = limb_places(live.keys[0], "left hand", body, betas)[0]
    torch.testing.assert_close(moved, place, atol=1e-3, rtol=0)
    foot = limb_places(live.keys[0], "right foot", body, betas)[0]
    app.keys.entries[0].handle.position = (2.0, 0.03, 1.0)  # all of it is moved: the arrows of its foot go with it
    for told in app.keys.entries[0].handle._impl_aux.update_cb:
        told(None)
    shifted = limb_places(live.keys[0], "right foot", body, betas)[0]
    assert (shifted - foot).norm() > 0.1
    torch.testing.assert_close(torch.tensor(limb.handle.position).float(), shifted, atol=1e-5, rtol=0)
    live.between()
    made = body.joints(live.scene)[0, 48:52, 0]
    for name, (*_, end) in LIMBS.items():
        torch.testing.assert_close(made[:, end], limb_places(live.keys[0], name, body, betas), atol=1e-3, rtol=0)
    limb.limb.value = "whole body"
    assert limb.handle is None
