// What a user does after the last step: sign the document, keep the profile, put the device into a site, and test without the device.

import { html } from "../vendor/preact.js";
import { Copyable } from "../lib/parts.js";
import { Download } from "./results.js";
import { isCan, made, newest, settled } from "./steps.js";

/** A word of a command line for a shell. */
const quoted = (text) => (/^[\w@%+=:,./#-]+$/.test(text) ? text : `'${text.replaceAll("'", `'"'"'`)}'`);

export function Finish({ ctx, folder }) {
  const document = made(ctx, "report");
  const recording = made(ctx, "record") || newest(ctx, "recording");
  const profile = ctx.draft || made(ctx, "infer") || newest(ctx, "profile") || ctx.profile;
  const isFile = ctx.files.some((f) => f.name === profile);
  const sheet = isCan(ctx.endpoint) && newest(ctx, "data sheet");
  const address = `${isCan(ctx.endpoint) ? "node" : "unit"}: ${ctx.address}`;
  const name = ctx.name.replace(/\W/g, "_");
  const device = `${name}=${isFile ? "./" : ""}${profile}@${settled(ctx)}#${ctx.address}`;
  return html`<section class="card finish">
    <h2>What comes next</h2>
    <ol>
      <li><strong>Sign the document.</strong> ${document ? html`Open <${Download} name=${document} />, print it and sign it.` : "This step writes it."} Keep it together with the files that it lists with their checksums. All files are in <code>${folder}</code>.</li>
      <li><strong>Keep the profile.</strong> ${profile
          ? isFile
            ? html`It is <${Download} name=${profile} />${sheet && html`, and needs its data sheet <${Download} name=${sheet} /> beside it`}. In a folder <code>profiles/devices</code> all commands find it by its name:
                <${Copyable} text=${`mkdir -p profiles/devices && cp ${[profile, sheet].filter(Boolean).join(" ")} profiles/devices/`} />`
            : html`The known profile <code>${profile}</code> fits. All commands find it by its name, so there is nothing to keep.`
          : isCan(ctx.endpoint)
            ? "There is no profile yet: the step Identify finds a known one, and the step Edit begins your own."
            : "There is no profile yet: the step Infer writes a draft, and the step Edit completes it."}</li>
      <li><strong>Put the device into a site.</strong> ${profile && ctx.endpoint
          ? html`This command writes a site with this device: the system file, a simulation, scenarios and a program.
              <${Copyable} text=${`fieldtwin new mysite --device ${quoted(device)} --yes`} />
              In the system file of an existing site, add one line to <code>devices</code>, with the name of your bus: <code>${name}: {profile: ${isFile ? "./" : ""}${profile}, bus: BUS, ${address}}</code>.`
          : "This needs the profile."}</li>
      <li><strong>Test without the device.</strong> The scenarios of the new site run on simulated devices: <${Copyable} text="fieldtwin test mysite" />
        ${recording && html`To see the recorded values in a run, write <code>recording: ../${recording}</code> in place of <code>simulation: ${name}</code> in <code>mysite/mysite.prototype.yaml</code>, and start <code>fieldtwin run mysite --prototype</code>. A scenario that sets a value needs the simulation.`}</li>
    </ol>
  </section>`;
}
