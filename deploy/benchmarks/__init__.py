"""How fast the parts are on this machine; `fieldpose bench` runs these."""
