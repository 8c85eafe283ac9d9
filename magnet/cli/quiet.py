"""Warnings and lines of a log that a user can do nothing about, and that a command keeps back."""

from __future__ import annotations

import logging
import warnings

SILENCED = (
    ".*does not have many workers.*",
    ".*LeafSpec.*",
    ".*logging interval.*",
    ".*is not empty.*",
    ".*callbacks used to create the checkpoint need to be provided.*",
    ".*The dirpath has changed.*",
    ".*in eval mode at the start of training.*",
    ".*could not find the monitored key.*",  # before a validation; `run_folder.what_is_left` says so
)
"""Warnings of Lightning's that do not apply to this command."""
UNSAID = ("Tip:", "`weights_only` was not set")
"""Lines of its log that are left out; the second does not apply: our checkpoints are never unpickled."""


def quiet() -> None:
    """Silence warnings that a user can do nothing about."""
    for text in SILENCED:
        warnings.filterwarnings("ignore", text)
    for part in ("utilities.rank_zero", "trainer.connectors.checkpoint_connector"):
        log = logging.getLogger(f"lightning.pytorch.{part}")
        if not log.filters:
            log.addFilter(lambda record: not any(text in record.getMessage() for text in UNSAID))
