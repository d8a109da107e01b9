"""Where methods break: 56 named ways to fail, each with what sets it off and how it is judged."""
