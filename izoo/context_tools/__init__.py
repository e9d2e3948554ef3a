"""What ``python -m izoo.contexts`` needs beyond the room of contexts: nets, pictures, and short simulations.

- :mod:`.commands`: all its subcommands;
- :mod:`.measured`: rebuilt Salt Lake City beside measured intersections;
- :mod:`.trial`: builds and plays a sample of intersections.
"""
