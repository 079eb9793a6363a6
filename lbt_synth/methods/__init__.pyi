from .method import DesignInputs as DesignInputs
from .method import Method as Method
from .method import Section as Section
from .registry import method_named as method_named
