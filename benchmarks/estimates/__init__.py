"""Parts of estimated.py: the source that `hoigs prepare` reads, and figures of what it makes."""
