// Third-party JavaScript servers and nodes of the league: `node servers.js NAME [LINE]`. It prints `0 PORT` when it serves.
//
// The device has 200 holding registers, 8 input registers, 48 coils and 16 discrete inputs, as in servers.py.

"use strict";

const net = require("net");

const say = (port) => process.stdout.write(`0 ${port}\n`);

function cells() {
  const holding = new Array(200).fill(0);
  holding[0] = 0xaa; holding[1] = 0xbb; holding[4] = 0x12;
  return { holding, input: [0x4120, 0, 0, 0, 0, 0, 0, 0], coils: new Array(48).fill(false), discrete: new Array(16).fill(false) };
}

function vector() {
  const { holding, input, coils } = cells();
  const at = (table, address) => {
    if (address in table) return table[address];
    const refusal = new Error("illegal data address");
    refusal.modbusErrorCode = 2;
    throw refusal;
  };
  const put = (table, address, value) => { at(table, address); table[address] = value; };
  return {
    getHoldingRegister: (address) => at(holding, address),
    getInputRegister: (address) => at(input, address),
    getCoil: (address) => at(coils, address),
    setRegister: (address, value) => put(holding, address, value),
    setCoil: (address, value) => put(coils, address, value),
    readDeviceIdentification: () => ({ 0: "fieldtwin", 1: "FT-1", 2: "V2.11" }),
  };
}

const SERVERS = {
  modbus_serial_tcp: () => {
    const server = new (require("modbus-serial").ServerTCP)(vector(), { host: "127.0.0.1", port: freePort, unitID: 1 });
    server.on("socketError", () => {});
    server.on("initialized", () => say(freePort));
  },
  modbus_serial_rtu: () => {
    const { ServerSerial } = require("modbus-serial");
    const server = new ServerSerial(vector(), { port: process.argv[3], baudRate: 115200, unitID: 1 });
    server.on("error", () => {});
    server.on("initialized", () => say(0));
  },
  jsmodbus_tcp: () => {
    const modbus = require("jsmodbus");
    const bytes = (values) => { const b = Buffer.alloc(2 * values.length); values.forEach((v, i) => b.writeUInt16BE(v, 2 * i)); return b; };
    const { holding, input } = cells();
    const listener = new net.Server();
    const server = new modbus.server.TCP(listener, {
      holding: bytes(holding), input: bytes(input), coils: Buffer.alloc(6), discrete: Buffer.alloc(2),
    });
    server.on("error", () => {});
    listener.listen(0, "127.0.0.1", () => say(listener.address().port));
  },
  canopen_js: () => {
    const { Device, DataType } = require("canopen");
    const { joinLines } = require("./clients.js");
    const device = new Device({ id: 5 });
    const socket = net.connect(Number(process.env.FIELDTWIN_CAN_LINE.split(":")[1]), "127.0.0.1");
    joinLines(socket, device);
    socket.once("connect", () => {
      device.eds.addSdoServerParameter(5, 0x585, 0x605);
      device.eds.addEntry(0x2000, { parameterName: "Value", dataType: DataType.INTEGER16, defaultValue: 7, lowLimit: -100, highLimit: 100 });
      device.eds.addEntry(0x2004, { parameterName: "Text", dataType: DataType.VISIBLE_STRING, defaultValue: "a text of more than one segment" });
      device.start();
      say(0);
    });
  },
};

let freePort = 0;
process.on("uncaughtException", (e) => process.stderr.write(`${e.stack}\n`));
const probe = net.createServer();
probe.listen(0, "127.0.0.1", () => {
  freePort = probe.address().port;
  probe.close(() => SERVERS[process.argv[2]]());
});
