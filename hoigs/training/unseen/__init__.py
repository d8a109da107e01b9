"""What no training frame shows: sides of people and objects, and the scene behind them."""

from hoigs.training.unseen.fill import fill_unseen
from hoigs.training.unseen.hidden_scene import spare_hidden

__all__ = ["fill_unseen", "spare_hidden"]
