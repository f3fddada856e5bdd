"""The whole cycle on a running graph, real or simulated: `longarm loop`."""
