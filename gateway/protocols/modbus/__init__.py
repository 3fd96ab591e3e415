"""The Modbus client, which carries out one transaction at a time, and the protocol part of the gateway's Modbus servers.

`requests` encodes PDUs, and `frames` adds the framing of the link. Only `requests.pdus` imports pymodbus. References are to the
Modbus Application Protocol (AP), Modbus over Serial Line (SL), the TCP/IP Implementation Guide (TG) and Modbus/TCP Security
(MBTLS); "MB-" and a number is a test case (tests/vectors).
"""
