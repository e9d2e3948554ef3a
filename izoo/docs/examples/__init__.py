"""Examples: each module runs by itself (``python -m izoo.docs.examples.NAME``), and its ``main`` takes the sizes."""
