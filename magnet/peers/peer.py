"""What the peers share: tokens of two people, training, and answering as a predictor."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from magnet.baselines.predictor import Generators, Predictor, joints_of
from magnet.body import Body
from magnet.denoiser.losses import token_losses
from magnet.denoiser.token_model import TokenModel
from magnet.generation.conditioning import mask_unknown
from magnet.generation.inputs import whole_tokens
from magnet.generation.plan import plan_of_frames
from magnet.motion.scene import Scene
from magnet.motion.tokens import TOKEN_FRAMES, TokenLayout
from magnet.peers.network import PeerNetwork
from magnet.sampling.noise import ddim_levels, ddim_step
from magnet.seeding import derive, step_generator
from magnet.tasks.base import Task
from magnet.tokenizer.base import PoseTokenizer
from magnet.training.optim import warmup_cosine
from magnet.training.options import OptimizerOptions, group_of, plain
from magnet.training.validation import log_means, places_of


class Peer(TokenModel):
    """Base of models of two people after other papers' ideas.

    A subclass makes its network in `build_network`, and implements `token_errors`, `require` and `generate`.

    Args:
        tokenizer: checkpoint of a trained tokenizer, or of a denoiser with one, or the name of a shipped model such as
            `duet`. A checkpoint of this module brings its own.
        max_agents: two. Linked to the data's.
        window: token steps of a training window. Linked to the data's.
        network: sizes.
        optimizer: AdamW.
        seed: all training noise follows from it.
    """

    def __init__(
        self,
        tokenizer: str | None = None,
        max_agents: int = 2,
        window: int = 16,
        network: PeerNetwork = PeerNetwork(),
        optimizer: OptimizerOptions = OptimizerOptions(),
        seed: int = 1111,
    ) -> None:
        super().__init__()
        if max_agents != 2:
            raise ValueError(f"max_agents: got {max_agents}, but {type(self).__name__} is a model of two people")
        self.validated = 0  # scenes of this process in the validation that is going on
        self.network, self.optimizer = group_of(PeerNetwork, network), group_of(OptimizerOptions, optimizer)
        sizes = {"tokenizer": tokenizer, "max_agents": max_agents, "window": window, "seed": seed}
        self.save_hyperparameters(plain({**sizes, "network": self.network, "optimizer": self.optimizer}))
        self.window = window
        self.build_named(tokenizer)

    def build(self, tokenizer: PoseTokenizer) -> None:
        """Make the parts whose sizes depend on the tokenizer."""
        self.hold(tokenizer, TokenLayout(tokenizer.codebook_dim, 2))
        self.build_network()

    # -- what a subclass implements --------------------------------------------------------------

    def build_network(self) -> None:
        """Make the network, once `layout` is known."""
        raise NotImplementedError(f"{type(self).__name__} must implement build_network()")

    def token_errors(
        self, own: Tensor, partner: Tensor, counts: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Terms of the loss, of everybody with his partner.

        own, partner (2 B, N, D) normalized tokens, counts (2 B, N) bool, steps in which both are there
        """
        raise NotImplementedError(f"{type(self).__name__} must implement token_errors()")

    def require(self, known: Tensor) -> None:
        """Refuse what the method cannot do. known (N, 2) bool. Raises ValueError."""
        raise NotImplementedError(f"{type(self).__name__} must implement require()")

    def generate(self, scene: Scene, known: Tensor, generators: Sequence[torch.Generator]) -> Scene:
        """Fill in what is not known.

        Args:
            scene: (B, 4 N, 2) two people, of whom only what is known is read.
            known: (N, 2) bool token steps.
            generators: one for each of the B scenes.

        Returns:
            (B, 4 N, 2), known frames as they were given.
        """
        raise NotImplementedError(f"{type(self).__name__} must implement generate()")

    # -- training --------------------------------------------------------------------------------

    @property
    def own_width(self) -> int:
        """Numbers of a token that say nothing of the partner: latent and deltas."""
        return self.layout.latent + 9 * TOKEN_FRAMES

    def losses(self, scene: Scene, generator: torch.Generator) -> dict[str, Tensor]:
        """The terms of the loss and their sum `loss`."""
        with torch.no_grad():
            tokens, there = self.tokenize(scene)
            own, partner = both_ways(self.normalizer.normalize(tokens))
            counts = there.all(dim=-1).transpose(1, 2).flatten(0, 1)
        terms = self.token_errors(own, partner, counts, generator)
        return {"loss": torch.stack(list(terms.values())).sum(), **terms}

    def training_step(self, batch: Scene, batch_idx: int) -> Tensor:
        place = (self.global_step, batch_idx, self.global_rank)
        losses = self.losses(batch, step_generator(self.device, self.hparams["seed"], "train", *place))
        self.log_dict({f"train/{name}": value.detach() for name, value in losses.items()}, batch_size=batch.scenes)
        self.log_loss(losses["loss"], batch_size=batch.scenes)
        return losses["loss"]

    def on_validation_epoch_start(self) -> None:
        self.validated = 0

    def validation_step(self, batch: Scene, batch_idx: int) -> None:
        for b, place in enumerate(places_of(self, batch, self.validated)):  # a scene's noise is its own
            one, seed = batch.select([b]), derive(self.hparams["seed"], "validation", place)
            losses = self.losses(one, torch.Generator(device=self.device).manual_seed(seed))
            log_means(self, {f"val/{name}": value for name, value in losses.items()}, one)
        self.validated += batch.scenes

    def errors_of(self, made: Tensor, truth: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """`token_losses` of tokens of one person beside the other. made, truth (M, N, D), counts (M, N) bool"""
        there = counts[..., None, None].expand(*counts.shape, 1, 2)
        return token_losses(made[:, :, None], truth[:, :, None], self.layout, there)

    def configure_optimizers(self) -> Any:
        self.require_tokenizer()
        return warmup_cosine(self, [each for each in self.parameters() if each.requires_grad], self.optimizer)

    # -- answering -------------------------------------------------------------------------------

    def predictor(self, task: Task, context: int, horizon: int, body: Body) -> Predictor:
        """The model as a method under test.

        Args:
            task: says what is known; nothing else of it matters.
            context: frames that are recorded of everybody, a multiple of 4.
            horizon: frames after them.
            body: whose joints are asked for.

        Raises:
            ValueError: the method cannot do this task.
        """
        known = self.known_by(task, context, horizon)

        def predicted(scene: Scene, samples: int, generators: Generators) -> Tensor:
            whole = self.sample(scene, known, context + horizon, samples, generators)
            return joints_of(whole.slice(context), body, samples)

        return predicted

    def known_by(self, task: Task, context: int, horizon: int) -> Tensor:
        """What a task gives of two people over so many frames. -> (N, 2) bool

        Raises:
            ValueError: the method cannot do this task.
        """
        known = plan_of_frames(task, 2, context, horizon, self.window).known
        self.require(known)
        return known

    @torch.no_grad()
    def sample(self, scene: Scene, known: Tensor, frames: int, samples: int, generators: Generators) -> Scene:
        """So many frames, sample s of scene b at b * samples + s.

        scene (B, T, P), of whom two are there, in the first two slots; known (N, 2) bool -> (B * samples, frames, P)

        Raises:
            ValueError: a scene is not of two people, or the method cannot go on from what is known.
        """
        self.require(known)
        if scene.agents < 2 or not bool(scene.present[:, :2].all()) or bool(scene.present[:, 2:].any()):
            people = scene.present.sum(dim=1).tolist()
            raise ValueError(f"got scenes of {people} people, expected two, in the first two slots of each")
        two = scene.replace(given=None).permute_agents(torch.arange(2, device=scene.device)).to_float32()
        if two.frames >= frames:
            two = whole_tokens(two, frames)
        two = mask_unknown(two, known).to(self.device).repeat(samples)
        with torch.autocast(self.device.type, enabled=False):
            made = self.generate(two, known, generators)
        return made.slice(0, frames).pad_agents(scene.agents).to(scene.device)


def both_ways(tokens: Tensor) -> tuple[Tensor, Tensor]:
    """Each person's tokens, and the partner's. (B, N, 2, D) -> (2 B, N, D) twice"""
    own, partner = (each.transpose(1, 2).flatten(0, 1) for each in (tokens, tokens.flip(2)))
    return own, partner


def denoised(predict: Callable[[Tensor, Tensor], Tensor], x: Tensor, steps: int) -> Tensor:
    """Noise made clean in so many DDIM steps; `predict` tells clean from (x, levels (M,) int). x (M, ...) -> same"""
    for now, after in itertools.pairwise(ddim_levels(steps).to(x.device)):
        x = ddim_step(x, predict(x, now.expand(len(x))), now, after)
    return x
