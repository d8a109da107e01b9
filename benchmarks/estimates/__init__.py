"""Parts of estimated.py and end_to_end.py: sources, figures of what is made, short trainings."""
