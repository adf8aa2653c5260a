"""The engine: from equations to scheduled, generated and cached kernels."""
