"""How far values are from the mean of their neighbours', and its gradient: `function`."""
