"""From a system to a passive output, an equilibrium and a shaped storage function, each with its proof."""
