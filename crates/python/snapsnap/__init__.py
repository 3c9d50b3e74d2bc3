"""Two photographs of a person, front and back, become 3D Gaussians.

    import snapsnap

    person = snapsnap.reconstruct("front.jpg", "back.jpg")
    person.save("human.ply")
    pictures = person.render(snapsnap.orbit(8, 512))

The world has y up, in metres, and the person stands on y = 0 and looks along +z. Arrays are float32. Colours are sRGB, 0 to 1.
"""

from ._gaussians import Gaussians, Mesh, Person, load
from ._native import InputError, __version__
from ._people import Networks, reconstruct
from ._rasterize import cameras, orbit, rasterize

__all__ = [
    "Gaussians", "InputError", "Mesh", "Networks", "Person", "__version__", "cameras", "load", "orbit", "rasterize", "reconstruct",
]
