"""Recursive filters: building blocks (`kalman`, `discretise`, `inertial`, `adaptive`), float ambiguities, systems of them."""
