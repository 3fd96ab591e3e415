"""All standard functions by name, with the conversions, whose names are composed of types."""

from __future__ import annotations

from fieldtwin.plc.st.compiler.functions.arrays import ARRAYS
from fieldtwin.plc.st.compiler.functions.conversions import conversion
from fieldtwin.plc.st.compiler.functions.library import ONE, Library, Standard
from fieldtwin.plc.st.compiler.functions.memory import MEMORY
from fieldtwin.plc.st.compiler.functions.numbers import NUMBERS
from fieldtwin.plc.st.compiler.functions.references import REFERENCES
from fieldtwin.plc.st.compiler.functions.scan import SCAN
from fieldtwin.plc.st.compiler.functions.strings import STRINGS
from fieldtwin.plc.st.compiler.functions.times import TIMES


class _Functions(Library):
    def find(self, name: str) -> Standard | None:
        """Return the function called `name` (in capitals), including conversions, or None."""
        found = self.by_name.get(name)
        if found is None and (write := conversion(name)) is not None:
            found = Standard(ONE, write)
        return found


FUNCTIONS = _Functions(NUMBERS, ARRAYS, TIMES, STRINGS, SCAN, REFERENCES, MEMORY)
