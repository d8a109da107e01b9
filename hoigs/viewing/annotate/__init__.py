"""`hoigs annotate`: click on people and objects of a video in a local page, and prepare it."""
