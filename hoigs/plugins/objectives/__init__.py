"""Terms of the loss, beside the image terms of `hoigs/training/objective.py`."""
