"""Semantic IDs of the Asset Interfaces Description (IDTA 02017-1-1), by the names of its elements.

Source: IDTA 02017-1-1 "Asset Interfaces Description", tables 2 to 7, 22, 26 and 35 to 37, and its annexes C and E. The tables
print version 1/0 for the elements and 1/1 for the submodel. All other IDs are those of W3C's Thing Description, which the AID
follows, and of its Modbus binding.
"""

from __future__ import annotations

_AID = "https://admin-shell.io/idta/AssetInterfacesDescription"
_TD = "https://www.w3.org/2019/wot/td#"
_MODBUS = "https://www.w3.org/2019/wot/modbus#"

SUBMODEL = f"{_AID}/1/1/Submodel"
SUBMODEL_PREFIX = f"{_AID}/"
INTERFACE = f"{_AID}/1/0/Interface"
MODBUS_INTERFACE = "http://www.w3.org/2011/modbus"
THING = "https://www.w3.org/2019/wot/td"
PROPERTY = f"{_AID}/1/0/PropertyDefinition"
PROPERTY_NAME = f"{_TD}name"
INTERACTION = f"{_TD}InteractionAffordance"
NO_SECURITY = "https://www.w3.org/2019/wot/security#NoSecurityScheme"

OF_ELEMENT = {
    "title": f"{_TD}title",
    "EndpointMetadata": f"{_AID}/1/0/EndpointMetadata",
    "base": f"{_TD}baseURI",
    "contentType": "https://www.w3.org/2019/wot/hypermedia#forContentType",
    "security": f"{_TD}hasSecurityConfiguration",
    "securityDefinitions": f"{_TD}definesSecurityScheme",
    "scheme": "https://www.w3.org/2019/wot/security#SecurityScheme",
    "InteractionMetadata": f"{_AID}/1/0/InteractionMetadata",
    "properties": f"{_TD}PropertyAffordance",
    "key": f"{_AID}/1/0/key",
    "type": "https://www.w3.org/1999/02/22-rdf-syntax-ns#type",
    "unit": "https://schema.org/unitCode",
    "min_max": f"{_AID}/1/0/minMaxRange",
    "forms": f"{_TD}hasForm",
    "href": "https://www.w3.org/2019/wot/hypermedia#hasTarget",
    "modv_function": f"{_MODBUS}hasFunction",
    "modv_entity": f"{_MODBUS}hasEntity",
    "modv_zeroBasedAddressing": f"{_MODBUS}hasZeroBasedAddressingFlag",
    "modv_timeout": f"{_MODBUS}hasTimeout",
    "modv_type": f"{_MODBUS}hasPayloadDataType",
    "modv_mostSignificantByte": f"{_MODBUS}hasMostSignificantByte",
    "modv_mostSignificantWord": f"{_MODBUS}hasMostSignificantWord",
}
