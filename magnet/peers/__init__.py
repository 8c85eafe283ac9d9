"""Small models after the ideas of other papers, on this package's tokens, to be measured beside it (docs/peers.md)."""

from magnet.peers.duolando import Duolando
from magnet.peers.peer import Peer
from magnet.peers.ready_to_react import ReadyToReact
from magnet.peers.remos import ReMoS

__all__ = ["Duolando", "Peer", "ReMoS", "ReadyToReact"]
