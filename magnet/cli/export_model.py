"""`magnet export-model OUT.onnx`: a denoiser and its tokenizer as ONNX files, for programs without torch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from magnet.cli.errors import CommandError
from magnet.cli.flags import PlainParser

EPILOG = """\
OUT.onnx is the denoiser; OUT_decoder.onnx makes poses of its tokens, OUT_encoder.onnx tokens of poses. Each is run by
onnxruntime before it is written and must give torch's numbers. What they take and give: docs/onnx.md. A model with
network.pairwise_posterior is exported only when --without_posterior says that it may be left out.

for example:
  magnet export-model duet.onnx --without_posterior
  magnet export-model mine.onnx --ckpt_path runs/duet_denoiser/latest/checkpoints/last.ckpt
  python examples/sample_without_torch.py duet.onnx dance.npz
"""


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    parser = PlainParser("export-model", __doc__, EPILOG)
    parser.add_argument("out", metavar="OUT.onnx", help="file to write; two more lie beside it")
    parser.add_argument("--ckpt_path", metavar="FILE", help="a checkpoint, or a model by name (default: duet)")
    parser.add_argument(
        "--without_posterior",
        action="store_true",
        help="of a model with network.pairwise_posterior the network alone, which is all that ONNX can hold and is "
        "less exact; changes nothing for other models",
    )
    options = parser.parse_args(list(arguments))
    out = Path(options.out)
    if out.suffix.lower() != ".onnx":
        raise CommandError(f"{out.name}: got {out.suffix or 'no suffix'}, expected .onnx")
    from magnet.files import require_place

    require_place(out)
    from magnet import checkpoints
    from magnet.denoiser.core import DenoiserCore
    from magnet.denoiser.portable import OPSET, save_onnx

    path = checkpoints.resolve(options.ckpt_path)
    model = DenoiserCore.load(path)
    if options.without_posterior:
        model.posterior = None
    for file, off in save_onnx(model, out, path.name.removesuffix(".ckpt")).items():
        print(f"written: {file} ({file.stat().st_size / 1e6:.1f} MB, opset {OPSET}, off by {off:.1g} from torch)")
    return 0
