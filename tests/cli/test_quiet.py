"""What a command keeps back."""

from __future__ import annotations

import pytest
from lightning.pytorch.trainer.connectors import checkpoint_connector

from magnet.cli.quiet import quiet


def test_what_does_not_apply_to_our_checkpoints_is_not_said(caplog: pytest.LogCaptureFixture) -> None:
    """Lightning's own logger of the line about `weights_only`, wherever it makes it."""
    quiet()
    checkpoint_connector.log.addHandler(caplog.handler)
    checkpoint_connector.log.warning("`weights_only` was not set, defaulting to `False`.")
    checkpoint_connector.log.warning("something else")
    checkpoint_connector.log.removeHandler(caplog.handler)
    assert set(caplog.messages) == {"something else"}
