"""All models of the gallery by name."""

from models import learned, machines, process, vehicles

MODELS = process.MODELS | vehicles.MODELS | machines.MODELS | learned.MODELS
