"""Options of the commands: frozen dataclasses, the choices of their groups, and what converts them from and to YAML."""
