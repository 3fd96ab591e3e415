// Third-party JavaScript clients of the league: `node clients.js NAME`, with the endpoint in the environment.
//
// Each reads two registers (one object) 20 ms after the last answer, with a timeout of 150 ms, and prints the first value. After an
// error it prints the error's name, and opens the connection again if that was lost.

"use strict";

const net = require("net");

const TIMEOUT_MS = 150;
const PAUSE_MS = 20;
const { FIELDTWIN_HOST: host, FIELDTWIN_TTY: tty, FIELDTWIN_CAN_LINE: canLine } = process.env;
const port = Number(process.env.FIELDTWIN_PORT);

const within = (promise, what) =>
  Promise.race([promise, new Promise((_, no) => setTimeout(() => no(new Error(what)), 5 * TIMEOUT_MS))]);

async function modbusSerial(connect) {
  const Client = require("modbus-serial");
  let client;
  const again = async () => {
    if (client && client.isOpen) return;
    client = new Client();
    client.setTimeout(TIMEOUT_MS);
    client.setID(1);
    client.on("error", () => {});
    await connect(client);
  };
  await again();
  return [async () => (await client.readHoldingRegisters(0, 2)).data[0], again];
}

async function jsmodbus(open, Kind) {
  let socket, client;
  const again = async () => {
    if (socket && !socket.destroyed && (socket.readyState === "open" || socket.isOpen)) return;
    socket = open();
    socket.on("error", () => {});
    client = new Kind(socket, 1, TIMEOUT_MS);
    await new Promise((yes) => socket.once(open.event, yes));
  };
  await again();
  return [async () => (await client.readHoldingRegisters(0, 2)).response.body.valuesAsArray[0], again];
}

const CLIENTS = {
  modbus_serial_tcp: () => modbusSerial((client) => client.connectTCP(host, { port })),
  modbus_serial_rtu: () => modbusSerial((client) => client.connectRTUBuffered(tty, { baudRate: 19200 })),

  jsmodbus_tcp: () => {
    const open = () => net.connect(port, host);
    open.event = "connect";
    return jsmodbus(open, require("jsmodbus").client.TCP);
  },
  jsmodbus_rtu: () => {
    const { SerialPort } = require("serialport");
    const open = () => new SerialPort({ path: tty, baudRate: 19200 });
    open.event = "open";
    return jsmodbus(open, require("jsmodbus").client.RTU);
  },

  modbus_stream_tcp: async () => {
    const modbus = require("modbus-stream");
    let stream, lost;
    const again = async () => {
      if (stream && !lost) return;
      lost = false;
      stream = await new Promise((yes, no) =>
        modbus.tcp.connect(port, host, { responseTimeout: TIMEOUT_MS, retry: 0, unitId: 1 }, (e, made) => (e ? no(e) : yes(made))));
      for (const event of ["close", "error"]) stream.on(event, () => { lost = true; });
    };
    await again();
    const read = () => new Promise((yes, no) =>
      stream.readHoldingRegisters({ address: 0, quantity: 2, extra: { unitId: 1 } }, (e, info) =>
        (e ? no(e) : yes(info.response.data[0].readUInt16BE(0)))));
    return [() => within(read(), "no callback"), again];
  },

  canopen_js: async () => {
    const { Device, DataType } = require("canopen");
    const device = new Device({ id: 0x7f });
    const socket = net.connect(Number(canLine.split(":")[1]), canLine.split(":")[0]);
    joinLines(socket, device);
    await new Promise((yes) => socket.once("connect", yes));
    device.eds.addSdoClientParameter(5, 0x605, 0x585);
    device.start();
    const upload = () =>
      device.sdo.upload({ deviceId: 5, index: 0x2000, subIndex: 0, dataType: DataType.UNSIGNED32, timeout: TIMEOUT_MS });
    return [upload, async () => {}];
  },
};

function joinLines(socket, device) {
  let pending = "";
  socket.setNoDelay(true);
  socket.on("data", (chunk) => {
    const lines = (pending + chunk).split("\n");
    pending = lines.pop();
    for (const line of lines) {
      const [id, data] = line.split("#");
      if (data.startsWith("R") || id.length === 8) continue;  // its messages have no such fields
      device.receive({ id: parseInt(id, 16), data: Buffer.from(data, "hex"), ext: false, rtr: false });
    }
  });
  device.addListener("message", (m) => {
    socket.write(`${m.id.toString(16).toUpperCase().padStart(3, "0")}#${Buffer.from(m.data).toString("hex").toUpperCase()}\n`);
  });
}

async function main() {
  const [read, again] = await CLIENTS[process.argv[2]]();
  for (;;) {
    try {
      const value = await read();
      if (value !== null && value !== undefined) console.log(String(value));
    } catch (e) {
      console.log((e && (e.name || e.err)) || "error");
      try {
        await within(again(), "no connection");
      } catch (e) {
        console.log("no connection");
      }
    }
    await new Promise((yes) => setTimeout(yes, PAUSE_MS));
  }
}

module.exports = { joinLines };
if (require.main === module) {
  process.on("uncaughtException", (e) => console.log(e.name));
  main();
}
