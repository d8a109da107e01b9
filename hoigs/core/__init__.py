"""What every part agrees on: the values that flow, the interfaces, and their composition."""
