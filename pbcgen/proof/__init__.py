"""Verdicts and provers: definiteness, sign, spectrum. Nothing here knows of control or physics."""
