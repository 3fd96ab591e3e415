// A client of node-opcua: reads, writes and subscribes over a signed and encrypted channel, and prints what it gets as JSON.
const { OPCUAClient, MessageSecurityMode, SecurityPolicy, UserTokenType, AttributeIds, DataType, ClientSubscription,
  TimestampsToReturn } = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");
const path = require("path");

const value = (data) => ({ value: data.value.value, status: data.statusCode.name, source: data.sourceTimestamp });

async function main([url, folder]) {
  const certificates = new OPCUACertificateManager({
    rootFolder: path.join(folder, "node-pki"), automaticallyAcceptUnknownCertificate: true,
  });
  await certificates.initialize();
  const client = OPCUAClient.create({
    applicationUri: "urn:test:client", certificateFile: path.join(folder, "hmi.crt"),
    privateKeyFile: path.join(folder, "hmi.pem"), clientCertificateManager: certificates, endpointMustExist: false,
    securityMode: MessageSecurityMode.SignAndEncrypt, securityPolicy: SecurityPolicy.Basic256Sha256,
    connectionStrategy: { maxRetry: 0 },
  });
  await client.connect(url);
  const user = { type: UserTokenType.UserName, userName: "anna", password: "correct horse" };
  const session = await client.createSession(user);
  const found = { read: {}, write: {}, samples: [] };
  for (const tag of ["sensor.temperature", "sensor.serial", "sensor.state"])
    found.read[tag] = value(await session.read({ nodeId: `ns=2;s=${tag}`, attributeId: AttributeIds.Value }));
  for (const [tag, dataType, number] of [
    ["fan.lamp", DataType.Boolean, true], ["fan.limit", DataType.Double, 1000], ["fan.mode", DataType.UInt16, 1],
  ]) {
    const item = { nodeId: `ns=2;s=${tag}`, attributeId: AttributeIds.Value, value: { value: { dataType, value: number } } };
    found.write[tag] = (await session.write(item)).name;
  }
  const subscription = ClientSubscription.create(session, {
    requestedPublishingInterval: 100, requestedLifetimeCount: 100, requestedMaxKeepAliveCount: 10,
    publishingEnabled: true, maxNotificationsPerPublish: 100, priority: 0,
  });
  const item = await subscription.monitor(
    { nodeId: "ns=2;s=sensor.temperature", attributeId: AttributeIds.Value },
    { samplingInterval: 50, queueSize: 100, discardOldest: true }, TimestampsToReturn.Both);
  await new Promise((resolve) => item.on("changed", (data) => {
    if (found.samples.push(value(data)) === 5) resolve();
  }));
  await subscription.terminate();
  await session.close();
  await client.disconnect();
  console.log("RESULT " + JSON.stringify(found));
}

main(process.argv.slice(2)).then(() => process.exit(0), (error) => { console.error(error); process.exit(1); });
