"""Pictures and reports of a model. Needs the extra ``plots``."""
