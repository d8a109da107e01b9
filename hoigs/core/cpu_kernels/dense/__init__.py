"""A layer of a network, relu(x W^T + b), and its gradients: `function`."""
