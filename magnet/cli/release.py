"""`magnet release CHECKPOINT NAME`: a trained denoiser as a folder that can be passed on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from magnet.cli.errors import CommandError
from magnet.cli.flags import PlainParser
from magnet.errors import counted

EPILOG = """\
Writes FOLDER/NAME: weights in float16, parts of at most 16 MB with a hash each; config.json with how to build the model
and what is known of its weights; README.md, unless there is one of yours. No optimiser state, no names of folders of
this machine, nothing that can run code. What training started from is read from the checkpoint, with what that was
trained on, its licence and the acknowledgement that it owes. Which terms your data set you, magnet does not know.

for example:
  magnet release last mine --trained_on "ten hours of our own duets" --licence CC-BY-4.0
  magnet release runs/finetune/latest mine --trained_on "our own duets" --licence "all rights reserved" --folder models
  magnet predict --ckpt_path models/mine --people 2 --out scene.html
"""


def parser() -> argparse.ArgumentParser:
    options = PlainParser("release", __doc__, EPILOG)
    add = options.add_argument
    add("checkpoint", metavar="CHECKPOINT", help="a file, a run's folder, or last or best: of the newest run in runs")
    add("name", metavar="NAME", help="of the model, and of its folder")
    add("--trained_on", metavar="TEXT", help="which data; needed unless they are those of configs/duet_*.yaml")
    add("--licence", metavar="TEXT", help="of the weights; needed where other data went into them, else Apache-2.0")
    folder = "where the model's folder is made (default: here)"
    add("--folder", type=Path, default=Path(), metavar="FOLDER", help=folder)
    add("--decoder", type=Path, metavar="FILE", help="checkpoint of a tokenizer trained on with decoder_only")
    return options


def main(arguments: Sequence[str] = ()) -> int:
    """Run the command. Returns the exit code."""
    given = parser().parse_args(list(arguments))
    if Path(given.name).name != given.name or given.name in (".", ".."):
        raise CommandError(f"NAME is {given.name!r}, expected a plain name; --folder says where")
    folder: Path = given.folder / given.name
    from magnet import checkpoints
    from magnet.files import require_place, write_text

    if folder.is_dir() and any(folder.iterdir()) and not checkpoints.is_released(folder):
        raise CommandError(f"{folder} is a folder of other files; choose another name, or another --folder")
    if given.name in checkpoints.names() and folder.resolve() == Path(given.name).resolve():
        raise CommandError(f"{given.name} is a model of the package, and would be loaded by that name; choose another")
    require_place(folder / "config.json")
    from magnet.cli.kept_checkpoints import checkpoint_of
    from magnet.cli.release_decoder import decoder_kept, require_kind, with_decoder
    from magnet.cli.release_record import about, card, same_card, summary, without_folders

    path = checkpoint_of(given.checkpoint)
    if (path / "config.json").is_file():
        raise CommandError(f"{path} is a released model already: pass on its folder as it is")
    checkpoint = checkpoints.read(path)
    require_kind(checkpoint, "denoiser")
    decoder = None
    if given.decoder:
        decoder = checkpoints.read(given.decoder)
        checkpoint = with_decoder(checkpoint, decoder)
    kept = decoder_kept(checkpoint["state_dict"], folder) if decoder is None else {}
    record = about(checkpoint, path, given.trained_on, given.licence, given.decoder) | kept
    plain = {part: without_folders(checkpoint.get(part)) for part in checkpoints.KEPT}
    readme = folder / "README.md"
    ours = not readme.exists() or same_card(folder)  # of the release that is there, which is about to be replaced
    checkpoints.write(checkpoint | plain, folder, record)
    parts = [part.stat().st_size for part in folder.glob("*.safetensors")]
    if ours:
        write_text(readme, card(given.name, record, sum(parts)))
    sizes = [f"{size / 1e6:.1f} MB" for size in (sum(parts), path.stat().st_size)]
    print(f"{folder}: {counted(len(parts), 'part')}, {sizes[0]} (the checkpoint: {sizes[1]})")
    print(summary(record))
    if not ours:
        print(f"magnet: {readme} is left as it was: see that it says the same of data and licence", file=sys.stderr)
    return 0
