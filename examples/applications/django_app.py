"""A system in a Django project, started by the first request that needs it: gunicorn django_app:application"""

from __future__ import annotations

import atexit
import threading

from django.conf import settings
from django.core.wsgi import get_wsgi_application
from django.http import HttpRequest, JsonResponse
from django.urls import path

import rr_actors as rr

settings.configure(DEBUG=False, ALLOWED_HOSTS=["127.0.0.1"], ROOT_URLCONF=__name__, SECRET_KEY="an example")


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> str:
        return f"/images/{device}"


_lock = threading.Lock()
_registrars: list[rr.Registrar] = []


def registrar() -> rr.Registrar:
    """Return the registrar of this process. Not at import: the server may fork after that."""
    with _lock:
        if not _registrars:
            system = rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="rr_state").start()
            atexit.register(system.stop)
            _registrars.append(system.open_registrar("web"))
        return _registrars[0]


def camera(_: HttpRequest, device: str) -> JsonResponse:
    with registrar().load("cameras/camera", device) as camera:
        return JsonResponse({"topic": camera.response})


urlpatterns = [path("cameras/<device>", camera)]
application = get_wsgi_application()
