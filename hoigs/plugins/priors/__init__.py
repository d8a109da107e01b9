"""Object initialisers: first points of an object, and its pose in every frame."""
