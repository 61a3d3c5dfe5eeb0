"""A differentiable, batched simulator of a small tracked or wheeled robot's drive and running gear."""

__version__ = "0.1.0"
