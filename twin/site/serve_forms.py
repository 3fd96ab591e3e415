"""The forms of the `serve` section of a system file, one for each kind of server.

A new kind is a form here with its own `kind`, an entry in `KINDS` and in `ServeForm`, and a resolver in
`fieldtwin.twin.site.serving`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from fieldtwin.twin.site.base_forms import Address, SiteModel, TagName

KINDS = ("modbus", "opcua", "http", "mqtt")
"""The kinds of servers. The first one is that of a server without `kind`."""


class ServedTagForm(SiteModel):
    """The place at which a tag is served: exactly one of the four tables, at a PDU address.

    `type` is the type of the served value. A quality register holds 0 for good quality.
    """

    input: Address | None = None
    holding: Address | None = None
    discrete: Address | None = None
    coil: Address | None = None
    type: Literal["bool", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"] | None = None
    order: Literal["ABCD", "CDAB", "BADC", "DCBA"] = "ABCD"
    quality: Address | None = Field(default=None, description="address of the tag's quality register")
    write: bool = Field(default=False, description="clients may write it if the plant allows writes")


class ModbusServeForm(SiteModel):
    """Tags, located variables of programs, or both, as Modbus TCP registers for HMIs and other controllers."""

    kind: Literal["modbus"] = "modbus"
    url: str = Field(examples=["tcp://127.0.0.1:1502"])
    unit: int = Field(default=1, ge=0, le=255)
    tags: dict[TagName, ServedTagForm] = Field(default={})
    addresses: Literal["openplc"] | None = Field(
        default=None, description="serve the located variables of the programs at the registers that OpenPLC gives them"
    )
    write: bool = Field(default=False, description="with addresses: clients may write %Q and %M variables")
    if_bad: Literal["exception", "nan"] = "exception"
    networks: list[str] = Field(
        default=["0.0.0.0/0", "::/0"], alias="from", description="the addresses that may connect"
    )
    clients: int = Field(default=16, ge=1, le=1000)
    roles: list[str] | None = Field(
        default=None, description="TLS: roles whose clients may read; default: every client"
    )
    write_roles: list[str] | None = Field(default=None, description="TLS: roles whose clients may write as well")
    idle_s: int = Field(
        default=0, ge=0, le=86_400, description="silent clients are disconnected after this time; 0: never"
    )

    @model_validator(mode="after")
    def _has_registers(self) -> ModbusServeForm:
        if not self.tags and self.addresses is None:
            raise ValueError("a server needs `tags` or `addresses`")
        if self.write and self.addresses is None:
            raise ValueError("`write` is for `addresses`; a tag has a separate key `write`")
        return self


class OpcuaSecurityForm(SiteModel):
    """Certificates and users of an OPC UA server. Relative paths begin at the folder of the system file."""

    certificate: str = Field(
        min_length=1,
        examples=["pki/server.der"],
        description="file of the server's application certificate, DER or PEM",
    )
    key: str = Field(min_length=1, examples=["pki/server.key.pem"], description="file of its private key, PEM")
    trusted: str = Field(
        min_length=1,
        examples=["pki/trusted"],
        description="folder with the certificates of the clients, or of their authorities",
    )
    users: str = Field(
        min_length=1, examples=["pki/users.yaml"], description="file of the users and their roles: view, operate"
    )


class OpcuaServeForm(SiteModel):
    """Every tag as a variable of an OPC UA server (IEC 62541). Without `security` it is read-only and listens on loopback
    only.
    """

    kind: Literal["opcua"]
    url: str = Field(examples=["opc.tcp://127.0.0.1:4840"])
    every_ms: int = Field(default=100, ge=10, le=60_000, description="interval at which the process image is read, ms")
    clients: int = Field(default=16, ge=1, le=1000)
    security: OpcuaSecurityForm | None = Field(
        default=None, description="admit only users of this file, over signed channels of trusted clients"
    )


class HttpServeForm(SiteModel):
    """Studio's REST and WebSocket interface to this run, without Studio's pages.

    Paths are relative to the system file. Without a token the server listens on loopback only, and clients only read.
    """

    kind: Literal["http"]
    url: str = Field(examples=["http://127.0.0.1:8080"])
    view_token: str | None = Field(default=None, description="file with the token of clients that only read")
    operate_token: str | None = Field(
        default=None, description="file with the token of clients that may also write, within the rules of the run"
    )
    names: list[str] = Field(default=[], max_length=32, description="other names of this computer that clients use")
    certificate: str | None = Field(default=None, description="https: PEM file with the server's certificate")
    key: str | None = Field(default=None, description="https: PEM file with the certificate's key, without a password")
    insecure: bool = Field(default=False, description="allow http beyond loopback: the network can read the token")
    clients: int = Field(default=32, ge=1, le=1000)


class SparkplugForm(SiteModel):
    """An edge node of Sparkplug B 3.0. The devices of the system are its devices."""

    group: str = Field(min_length=1, max_length=200)
    node: str | None = Field(default=None, min_length=1, max_length=200, description="default: the name of the system")
    host: str | None = Field(
        default=None, min_length=1, max_length=200,
        description="the primary host application; nothing is published while it is offline",
    )  # fmt: skip
    writes: bool = Field(
        default=False, description="pass commands (DCMD) for `writable` tags on to the gateway; default: refuse them"
    )


class JsonTopicsForm(SiteModel):
    """A message in JSON for each tag, on topics by template."""

    topic: str = Field(default="fieldtwin/{system}/{device}/{tag}", max_length=1000)
    status: str = Field(default="fieldtwin/{system}/status", max_length=1000, description="`online` or `offline`")
    retain: bool = Field(default=True, description="the broker keeps the latest message of each topic")
    qos: Literal[0, 1, 2] = 1
    publish: Literal["change", "interval"] = "change"
    history: bool = Field(default=False, description="publish values of the time without a connection later")


class MqttServeForm(SiteModel):
    """Every tag as a message to an MQTT broker: Sparkplug B, or JSON on topics by template."""

    kind: Literal["mqtt"]
    url: str = Field(examples=["mqtt://127.0.0.1:1883"])
    sparkplug: SparkplugForm | None = None
    json_topics: JsonTopicsForm | None = Field(default=None, alias="json")
    every_ms: int = Field(
        default=1000, ge=10, le=3_600_000, description="interval at which the process image is read, ms"
    )
    buffer_samples: int = Field(default=10_000, ge=100, le=1_000_000, description="samples kept without a connection")
    buffer_kb: int = Field(default=4096, ge=64, le=1_048_576, description="memory for these samples, KiB")


def kind_of(section: Any) -> Any:
    """Return the kind that a server of the file states; that of a server without `kind` is `modbus`."""
    return section.get("kind", KINDS[0]) if isinstance(section, dict) else getattr(section, "kind", KINDS[0])


ServeForm = Annotated[
    Annotated[ModbusServeForm, Tag("modbus")]
    | Annotated[OpcuaServeForm, Tag("opcua")]
    | Annotated[HttpServeForm, Tag("http")]
    | Annotated[MqttServeForm, Tag("mqtt")],
    Discriminator(kind_of),
]
"""One server of the `serve` section."""
