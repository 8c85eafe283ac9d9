"""`TokenModelCore`: what a network over motion tokens keeps beside itself, its tokenizer, statistics and checkpoint.

Lightning takes longer to import than a model to load, so nothing here needs it; for training there is `TokenModel`.
"""

from __future__ import annotations

import functools
import inspect
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from magnet import checkpoints
from magnet.denoiser.options import Sampling
from magnet.denoiser.transformer import FEW_SLOTS
from magnet.errors import warn_user
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout, scene_transforms
from magnet.precision import cpu_by_default
from magnet.shared import digest, is_sharing, once
from magnet.tokenizer.base import PoseTokenizer
from magnet.tokenizer.core import TokenizerCore
from magnet.tokenizer.features import delta_known
from magnet.tokenizer.lean import Growing, encoded, encoded_plainly
from magnet.tokenizer.normalizer import Normalizer
from magnet.tokenizer.raw import RawPose
from magnet.training import origins
from magnet.waiting import may_look


class TokenModelCore(nn.Module):
    """Base of networks that predict motion tokens; holds the frozen tokenizer it was trained with.

    A subclass keeps its options with `keep`, builds its network in `build`, and ends its `__init__` with
    `build_named`.
    """

    tokenizer: PoseTokenizer
    layout: TokenLayout
    normalizer: Normalizer
    window: int  # token steps that the network sees at once
    sampling: Sampling = Sampling()  # how it is best sampled
    trained_body: str | None = None  # id of the body that its weights were trained with; None: nobody recorded it

    def __init__(self) -> None:
        super().__init__()
        self._tokenizer_digest: str | None = None

    def keep(self, options: dict[str, Any]) -> None:
        """Keep the options it was built with as `hparams`."""
        self.hparams = options

    @property
    def device(self) -> torch.device:
        return next(self.parameters(), torch.empty(0)).device

    # -- parts ---------------------------------------------------------------------------------

    def build(self, tokenizer: PoseTokenizer) -> None:
        """Make the parts whose sizes depend on the tokenizer, any `PoseTokenizer`."""
        raise NotImplementedError(f"{type(self).__name__} must implement build(tokenizer)")

    def hold(self, tokenizer: PoseTokenizer, layout: TokenLayout) -> None:
        """Freeze the tokenizer, and make room for the statistics of its tokens."""
        self.tokenizer = tokenizer.requires_grad_(False).eval()
        self._tokenizer_digest = None
        self.layout = layout
        self.normalizer = Normalizer(layout.width, floor=0.0)

    def build_named(self, tokenizer: str | None) -> None:
        """Build with the tokenizer of a name or path; nothing where that is not there, for a checkpoint brings its own.

        `raw`: plain poses instead (ablation, paper Table 5).
        """
        if tokenizer == "raw":
            self.build(RawPose())
        elif tokenizer is not None and checkpoints.named(tokenizer).exists():
            self.build(TokenizerCore.load(tokenizer))

    @property
    def quantized(self) -> bool:
        """Whether latents are codes, in training and so in sampling."""
        return True

    @property
    def narrow(self) -> bool:
        """Whether latents are narrow codes, whose numbers are standardized one by one."""
        return isinstance(self.tokenizer, TokenizerCore) and self.tokenizer.network.embed_dim > 0

    @property
    def built(self) -> bool:
        return hasattr(self, "normalizer")

    def require_tokenizer(self) -> None:
        if not self.built:
            start = self.hparams.get("start_from")
            name = "tokenizer" if self.hparams["tokenizer"] or not start else "start_from"
            path = self.hparams[name]
            given = "not given" if path is None else f"{path!r}, which is no file and no shipped model"
            raise ValueError(
                f"the model has no tokenizer: --model.{name} is {given}. "
                "Train one with `magnet fit --config configs/synthetic_tokenizer.yaml` and give its checkpoint, or go "
                "on from the shipped model: --model.start_from duet"
            )

    def require_statistics(self) -> None:
        if not self.normalizer.ready:
            raise ValueError(
                "the denoiser is not trained: it does not know how tokens are normalized; load a checkpoint, give "
                "Trainer.fit a data module, or take it from scenes, model.fit_normalizer(*model.tokenize(scenes))"
            )

    def train(self, mode: bool = True) -> Self:
        super().train(mode)
        if self.built:
            self.tokenizer.eval()  # frozen: its codebook must never move
        return self

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        tokenizer = self.tokenizer
        checkpoint["tokenizer_hyper_parameters"] = (
            dict(tokenizer.hparams) if isinstance(tokenizer, TokenizerCore) else None
        )

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Bring back the tokenizer that the checkpoint was trained with, whatever was given here."""
        checkpoints.require_denoiser(checkpoint)
        self.trained_body = origins.body_of(checkpoint)
        stored = checkpoint["tokenizer_hyper_parameters"]
        given = dict(self.tokenizer.hparams) if self.built and isinstance(self.tokenizer, TokenizerCore) else None
        if not self.built or stored != given:
            self.build(RawPose() if stored is None else tokenizer_of(stored))
            self.to(self.device)

    @classmethod
    @cpu_by_default
    def load(cls, name_or_path: str | Path | None = None) -> Self:
        """A trained model ready for use: one that comes with the package by name, or a checkpoint's path.

        A warning says where it was trained as a class of somebody's own, and is loaded as another.

        Raises:
            ValueError: no such checkpoint, not a denoiser's, or of a class with other weights.
        """
        path = checkpoints.resolve(name_or_path)
        checkpoint = checkpoints.read(path, halves=True)
        checkpoints.require_denoiser(checkpoint, path)
        fields = taken_by(cls)  # Lightning's command line stores more than these
        stored = {name: value for name, value in checkpoint["hyper_parameters"].items() if name in fields}
        model = cls(**{**stored, **{name: None for name in ("tokenizer", "start_from") if name in fields}})
        model.on_load_checkpoint(checkpoint)
        trained, own = checkpoints.class_of(checkpoint), cls.__name__.removesuffix("Core")
        name = trained.rpartition(".")[2]
        known = [each.__name__ for each in cls.__mro__ if not each.__module__.startswith("magnet.")]
        other = not trained.startswith("magnet.") and name not in known
        if lost := sorted(model.state_dict().keys() ^ checkpoint["state_dict"].keys()):
            hint = f"; it was trained as {trained}: load it with {name}.load" if other else ""
            raise ValueError(f"{path}: holds other weights than a {own} of its options has, such as {lost[0]}{hint}")
        if other:
            warn_user(
                f"{path} was trained as {trained}, and is a plain {own} here: what that class does otherwise is left "
                f"out. In Python, magnet.Model({name}.load(path)) keeps it"
            )
        model.load_state_dict(checkpoint["state_dict"])
        return model.float().eval()  # also where torch's default is another dtype

    # -- scenes and tokens -----------------------------------------------------------------------

    def encode(
        self, scene: Scene, tokens: slice = slice(None), packed: bool = False, growing: Growing | None = None
    ) -> Tensor:
        """Latents of those present, codes if `quantized`; invalid frames are not looked at. -> (B, N, P, C) float32

        The first and the last pose are held for a token each and those tokens dropped: beyond the edge a
        convolution sees zeros, which would give the last known token, of all, a code that is used nowhere else.
        `tokens` says which are wanted; `packed`, `growing`: see `magnet.tokenizer.lean`.
        """
        everybody = not may_look(scene.device) and scene.agents <= FEW_SLOTS
        held = (each_slot(scene) if everybody else scene.people()).pad_frames(TOKEN_FRAMES)
        first, stop, _ = tokens.indices(scene.frames // TOKEN_FRAMES)
        wanted = slice(first + 1, stop + 1)
        encode = functools.partial(encoded, growing=growing) if packed else encoded_plainly
        people = encode(self.tokenizer, held, self.quantized, wanted)[:, :, 0]
        if everybody:
            latent = people.unflatten(0, scene.present.shape)
            return torch.where(scene.present[..., None, None], latent, 0.0).transpose(1, 2)
        latent = people.new_zeros(scene.scenes, scene.agents, *people.shape[1:])
        latent[scene.present] = people
        return latent.transpose(1, 2)

    def parts_of(self, tokens: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What normalized tokens (..., P, D) say, in real units, as `TokenLayout.unpack`: latent, deltas, pairs."""
        return self.layout.unpack(self.normalizer.denormalize(tokens))

    def tokens_of(self, latent: Tensor, deltas: Tensor, pairs: Tensor) -> Tensor:
        """The normalized tokens that say it; the inverse of `parts_of`. -> (..., P, D)"""
        return self.normalizer.normalize(self.layout.pack(latent, deltas, pairs))

    def tokenize(self, scene: Scene) -> tuple[Tensor, Tensor]:
        """Tokens in real units (B, N, P, D) and which groups of them count (B, N, P, 1 + slots) bool.

        A token counts where its frames and the one before are valid: its first delta comes from there.
        """
        scene = scene.pad_agents(self.layout.agents)
        latent = self._encoded(scene)
        with torch.autocast(scene.device.type, enabled=False):  # half precision would blur the transforms
            tokens = self.layout.pack(latent, *scene_transforms(scene))
        there = self.layout.group_present(scene.present)[:, None].expand(*tokens.shape[:3], -1)
        if scene.valid is not None:
            whole = delta_known(scene.valid).unflatten(1, (-1, TOKEN_FRAMES)).all(dim=-1)
            there = there & whole[:, :, None, None]
        return tokens, there

    def _encoded(self, scene: Scene) -> Tensor:
        """As `encode`; runs that share their work encode a batch once that all of them see."""
        trained = isinstance(self.tokenizer, TokenizerCore)  # else latents are as wide as poses, and cost nothing
        if not trained or not is_sharing() or self.device.type != "cpu":
            return self.encode(scene)
        if self._tokenizer_digest is None:  # it is frozen
            self._tokenizer_digest = digest(*self.tokenizer.state_dict().values())
        seen = digest(scene.body_rot, scene.T_world_root, scene.betas, scene.present, scene.valid)
        return once(("latents", self._tokenizer_digest, self.quantized, seen), lambda: self.encode(scene))


def each_slot(scene: Scene) -> Scene:
    """Each slot as a scene of its own, (B P, T, 1), whether somebody is in it or not: nobody is looked for."""
    B, P = scene.present.shape
    return Scene(
        body_rot=scene.body_rot.transpose(1, 2).flatten(0, 1).unsqueeze(2),
        T_world_root=scene.T_world_root.transpose(1, 2).flatten(0, 1).unsqueeze(2),
        betas=scene.betas.reshape(B * P, 1, -1),
        present=scene.present.reshape(B * P, 1),
        fps=scene.fps,
        body=scene.body,
        valid=None if scene.valid is None else scene.valid.repeat_interleave(P, dim=0),
    )


def tokenizer_of(options: dict[str, Any]) -> TokenizerCore:
    """The tokenizer that a checkpoint says its model was trained with, without its weights."""
    try:
        return TokenizerCore(**options)
    except TypeError as error:
        raise ValueError(f"its tokenizer is of a later version than this one, or damaged: {error}") from error


def taken_by(kind: type) -> set[str]:
    """Parameters of a class's `__init__`, and of its bases' as far as it hands on `**kwargs`."""
    names: set[str] = set()
    for each in kind.__mro__:
        if "__init__" in vars(each):
            parameters = inspect.signature(each).parameters
            names |= set(parameters)
            if all(parameter.kind != inspect.Parameter.VAR_KEYWORD for parameter in parameters.values()):
                break
    return names
