"""The alarms of a system after ISA-18.2 and IEC 62682: their conditions, states, acknowledgement and shelving."""
