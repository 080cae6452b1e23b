"""What every primitive does to bounds; `registry` says which rule belongs to which primitive."""
