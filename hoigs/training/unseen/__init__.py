"""What no training frame shows: sides of people and objects, and the scene behind them."""

from hoigs.training.unseen.fill import fill_unseen
from hoigs.training.unseen.filling import Filling

__all__ = ["Filling", "fill_unseen"]
