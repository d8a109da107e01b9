"""pycolmap; every module takes it from here.

Importing it installs handlers of glog: SIGTERM would print a stack and end the process at once, and
locks and temporary files would stay. SIGTERM is set back to what it was.
"""

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402

__all__ = ["pycolmap"]

# Python sets handlers in its main thread alone
if threading.current_thread() is threading.main_thread() and _before is not None:
    signal.signal(signal.SIGTERM, _before)
