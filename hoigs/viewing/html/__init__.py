"""A run as one HTML file that plays in a browser without a network.

- `page.write_page`: the file.
- `tracks.Track`: one entity over time, as the file stores it.
- `player.html`, `player.js`, `player.css`: what is in the file besides the data.
"""
