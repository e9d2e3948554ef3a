"""Options of the commands: frozen dataclasses, and the Hydra YAML groups beside them.

``compose`` turns command-line words into a validated dataclass; ``build`` converts between mappings and dataclasses.
"""
