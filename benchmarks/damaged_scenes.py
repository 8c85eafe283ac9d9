"""Ten recorded scenes, three pushed into each other, three floated, three slid, one all of it, and `magnet refine`.

MAGNET_CMU=... python benchmarks/damaged_scenes.py --out runs/results/damaged
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch

from magnet.body import load_body
from magnet.body.contact import deepest
from magnet.body.repair import repaired
from magnet.datamodules.cmu import CMU
from magnet.metrics import hand_distance, lowest_foot, toe_steps
from magnet.motion.scene import Scene, concatenate

BODY = load_body()


def damaged(scene: Scene, kind: str) -> Scene:
    """One of two people pushed 15 cm into the other; 12 cm up and the other 5 cm down; or both sliding at 0.3 m/s.

    kind: "pushed", "floated", "slid" or "all", one after the other.
    """
    if kind == "all":
        return damaged(damaged(damaged(scene, "pushed"), "floated"), "slid")
    roots, time = scene.T_world_root.clone(), torch.arange(scene.frames) / scene.fps
    if kind == "pushed":
        way = (roots[:, :, 1, :3, 3] - roots[:, :, 0, :3, 3]) * torch.tensor([1.0, 0.0, 1.0])
        grown = torch.sin(math.pi * torch.arange(scene.frames) / scene.frames)[:, None]
        roots[:, :, 0, :3, 3] += 0.15 * grown * way / way.norm(dim=-1, keepdim=True)
    elif kind == "floated":
        roots[:, 30:120, 0, 1, 3] += 0.12
        roots[:, 100:, 1, 1, 3] -= 0.05
    else:
        for agent, axis in ((0, 0), (1, 2)):
            roots[:, :, agent, axis, 3] += 0.3 * 1.2 * torch.sin(time / 1.2)
    return scene.replace(T_world_root=roots)


def row(scene: Scene, real: Scene) -> str:
    joints = BODY.joints(scene)
    depth = deepest(joints[:, :, 0].flatten(0, 1), joints[:, :, 1].flatten(0, 1))
    speed, stands = toe_steps(joints)
    foot = lowest_foot(joints)
    hands = hand_distance(joints[:, :, 0], joints[:, :, 1]) < 0.2
    off = (joints - BODY.joints(real)).norm(dim=-1).mean()
    shares = (depth[:, 1] > 0.05, depth[:, 1] > 0.10, speed[stands] < 0.05, foot > 0.06, foot < -0.02, hands)
    cells = " | ".join(f"{100 * float(share.float().mean()):.1f} %" for share in shares)
    jerk = (joints.diff(n=3, dim=1) * scene.fps**3).norm(dim=-1).mean()
    return f"{100 * float(depth[:, 0].max()):.1f} cm | {cells} | {float(jerk):.0f} m/s³ | {100 * float(off):.1f} cm"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for the scenes, before and after")
    out = parser.parse_args().out
    data = CMU(singles=False)
    data.prepare_data()
    data.setup("test")
    scenes = concatenate(list(data.test_dataloader()))
    scenes = scenes.select(list(range(0, scenes.scenes, max(1, scenes.scenes // 10)))[:9])
    cells = "deepest | body over 5 cm | over 10 cm | toes still | in the air | in the floor | hands | jerk | off"
    print(f"| scene | {cells} |")
    kinds = [("pushed", "floated", "slid")[number % 3] for number in range(scenes.scenes)]
    for number, kind in [*enumerate(kinds), (len(kinds) // 2, "all")]:
        real = scenes.select([number])
        bad = damaged(real, kind)
        good = repaired(bad, BODY)
        for name, scene in (("recorded", real), ("damaged", bad), ("repaired", good)):
            print(f"| {number} {kind}, {name} | {row(scene, real)} |", flush=True)
            if out:
                scene.save(out / f"{number}_{kind}_{name}.npz")


if __name__ == "__main__":
    main()
